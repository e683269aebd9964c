<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable">
  <fieldConfiguration>
    <field name="from_m" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
    <field name="to_m" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="2" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
    <field name="weight" configurationFlags="None">
      <editWidget type="Range">
        <config>
          <Option type="Map">
            <Option type="int" value="3" name="Precision" />
          </Option>
        </config>
      </editWidget>
    </field>
  </fieldConfiguration>
  <aliases>
    <alias name="Source" field="source" />
    <alias name="Source feature" field="source_fid" />
    <alias name="Drive" field="drive" />
    <alias name="Local map" field="instance" />
    <alias name="Element" field="element_id" />
    <alias name="From (m)" field="from_m" />
    <alias name="To (m)" field="to_m" />
    <alias name="Weight" field="weight" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="source" hidden="0" width="-1" />
      <column type="field" name="source_fid" hidden="0" width="-1" />
      <column type="field" name="drive" hidden="0" width="-1" />
      <column type="field" name="instance" hidden="0" width="-1" />
      <column type="field" name="element_id" hidden="0" width="-1" />
      <column type="field" name="from_m" hidden="0" width="-1" />
      <column type="field" name="to_m" hidden="0" width="-1" />
      <column type="field" name="weight" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>4</layerGeometryType>
</qgis>
