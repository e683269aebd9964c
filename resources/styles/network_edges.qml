<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable">
  <renderer-v2 type="singleSymbol" symbollevels="0" referencescale="-1" enableorderby="0" forceraster="0">
    <symbols>
      <symbol type="line" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="112,112,112,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.2" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <fieldConfiguration>
    <field name="distance_m" configurationFlags="None">
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
    <alias name="From observation" field="from_observation" />
    <alias name="To observation" field="to_observation" />
    <alias name="Component" field="component" />
    <alias name="Class" field="class" />
    <alias name="Distance (m)" field="distance_m" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="from_observation" hidden="0" width="-1" />
      <column type="field" name="to_observation" hidden="0" width="-1" />
      <column type="field" name="component" hidden="0" width="-1" />
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="distance_m" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>1</layerGeometryType>
</qgis>
