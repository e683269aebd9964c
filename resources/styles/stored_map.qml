<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable|Temporal">
  <renderer-v2 type="categorizedSymbol" symbollevels="0" referencescale="-1" enableorderby="0" attr="class" forceraster="0">
    <categories>
      <category label="Pedestrian crossing" value="ped_crossing" render="true" symbol="0" />
      <category label="Divider" value="divider" render="true" symbol="1" />
      <category label="Boundary" value="boundary" render="true" symbol="2" />
      <category label="Other class" value="" render="true" symbol="3" />
    </categories>
    <symbols>
      <symbol type="line" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="0,114,178,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.9" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option type="QString" value="" name="name" />
              <Option type="Map" name="properties">
                <Option type="Map" name="outlineStyle">
                  <Option type="bool" value="true" name="active" />
                  <Option type="QString" value="if(&quot;state&quot; = 'tentative', 'dot', 'solid')" name="expression" />
                  <Option type="int" value="3" name="type" />
                </Option>
              </Option>
              <Option type="QString" value="collection" name="type" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="1" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="213,94,0,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.9" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option type="QString" value="" name="name" />
              <Option type="Map" name="properties">
                <Option type="Map" name="outlineStyle">
                  <Option type="bool" value="true" name="active" />
                  <Option type="QString" value="if(&quot;state&quot; = 'tentative', 'dot', 'solid')" name="expression" />
                  <Option type="int" value="3" name="type" />
                </Option>
              </Option>
              <Option type="QString" value="collection" name="type" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="2" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="0,158,115,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.9" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option type="QString" value="" name="name" />
              <Option type="Map" name="properties">
                <Option type="Map" name="outlineStyle">
                  <Option type="bool" value="true" name="active" />
                  <Option type="QString" value="if(&quot;state&quot; = 'tentative', 'dot', 'solid')" name="expression" />
                  <Option type="int" value="3" name="type" />
                </Option>
              </Option>
              <Option type="QString" value="collection" name="type" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="3" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="204,121,167,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.9" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option type="QString" value="" name="name" />
              <Option type="Map" name="properties">
                <Option type="Map" name="outlineStyle">
                  <Option type="bool" value="true" name="active" />
                  <Option type="QString" value="if(&quot;state&quot; = 'tentative', 'dot', 'solid')" name="expression" />
                  <Option type="int" value="3" name="type" />
                </Option>
              </Option>
              <Option type="QString" value="collection" name="type" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <fieldConfiguration>
    <field name="score" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
    <field name="length_m" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
    <field name="sigma_m" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
    <field name="evidence" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
  </fieldConfiguration>
  <aliases>
    <alias name="Element" field="element_id" />
    <alias name="Class" field="class" />
    <alias name="Score" field="score" />
    <alias name="Observations" field="n_observations" />
    <alias name="Local maps" field="n_instances" />
    <alias name="Length (m)" field="length_m" />
    <alias name="Sigma (m)" field="sigma_m" />
    <alias name="First seen" field="first_seen" />
    <alias name="Last seen" field="last_seen" />
    <alias name="State" field="state" />
    <alias name="Evidence" field="evidence" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="&quot;element_id&quot;">
    <columns>
      <column type="field" name="element_id" hidden="0" width="-1" />
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="score" hidden="0" width="-1" />
      <column type="field" name="n_observations" hidden="0" width="-1" />
      <column type="field" name="n_instances" hidden="0" width="-1" />
      <column type="field" name="length_m" hidden="0" width="-1" />
      <column type="field" name="sigma_m" hidden="0" width="-1" />
      <column type="field" name="first_seen" hidden="0" width="-1" />
      <column type="field" name="last_seen" hidden="0" width="-1" />
      <column type="field" name="state" hidden="0" width="-1" />
      <column type="field" name="evidence" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <temporal enabled="1" mode="2" limitMode="1" startField="first_seen" endField="last_seen" accumulate="0" fixedDuration="0" durationField="" durationUnit="min" startExpression="" endExpression="">
    <fixedRange>
      <start></start>
      <end></end>
    </fixedRange>
  </temporal>
  <layerGeometryType>1</layerGeometryType>
</qgis>
